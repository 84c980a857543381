"""What docs/learning.md shows: results of the recorded trainings, and what each part is worth."""
