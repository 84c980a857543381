"""What an IMM is tuned in, and how: banks before tuning, where to search, on which episodes."""
