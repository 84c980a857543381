"""Whether this machine computes what it should: a self-test; and which packages there are."""
