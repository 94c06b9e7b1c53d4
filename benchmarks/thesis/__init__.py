"""What the bachelor thesis measured that this package grew from."""
