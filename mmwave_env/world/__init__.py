"""The simulated world: episodes of users in streets, observed through a radio channel."""
