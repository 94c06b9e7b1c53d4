"""The rolling record that `up` keeps: the last minutes on disk, and who asked for what."""
