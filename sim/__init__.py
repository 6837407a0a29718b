"""The rig in software: plant, imperfections and effects, and its true frequency response."""
