"""Writes a profile for an arm from its description: what it says, and guesses for the rest."""
