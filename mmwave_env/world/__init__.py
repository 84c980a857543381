"""The world: users in streets, seen through a channel, as episodes; no filter and no data set."""
