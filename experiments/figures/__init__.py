"""Pictures, one call each, in one style."""
