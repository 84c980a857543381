"""Many steps on damaged data, every number checked."""
