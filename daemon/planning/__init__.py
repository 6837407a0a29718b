"""Turn a session or a command into segments, in a process of their own, before anything flies."""
