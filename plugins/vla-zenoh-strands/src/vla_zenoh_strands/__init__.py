"""An arm of ours as a peer of the strands-robots mesh."""
