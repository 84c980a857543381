"""The world: episodes, simulated or recorded. No filter is known here."""
