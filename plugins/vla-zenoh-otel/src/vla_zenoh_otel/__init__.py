"""OpenTelemetry traces, from an image to the first command of the chunk that answers it."""
