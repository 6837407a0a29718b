"""Open files safely: written completely or not at all, through no link of another user."""
