"""How far the actions of two workers are apart."""
