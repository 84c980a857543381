"""Pictures in one style, with one function for each."""
