"""Data sets of transitions, for those who learn offline."""
