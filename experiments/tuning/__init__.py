"""Tuning of modes by likelihood or error, and of the bank of an IMM by reward."""
