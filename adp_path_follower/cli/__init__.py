"""The `adp` command."""
