"""Demo: motion segments on a simulated robot, judged by measured poses, with a run folder."""
