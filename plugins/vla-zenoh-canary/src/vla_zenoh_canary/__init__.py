"""A new model in shadow on several robots: its figures, its promotion, and the way back."""
