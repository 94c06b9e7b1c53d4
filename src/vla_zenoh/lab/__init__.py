"""Looks at runs: records, evaluates, shows and compares them. The core never imports it."""
