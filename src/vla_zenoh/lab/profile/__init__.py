"""What is wrong with a profile, and what could be better."""
