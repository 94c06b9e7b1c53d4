"""The thesis's ten motions, at several rates: how well the simulated arm does them."""
