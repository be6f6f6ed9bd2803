"""TOML files to loops and tasks, and back."""
