"""The force balance M q'' + D q' + K q = B u below a frequency limit, from measured signals."""
