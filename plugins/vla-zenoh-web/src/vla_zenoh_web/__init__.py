"""A page for browsers that watches and drives one robot, by an ordinary client of the bus."""
