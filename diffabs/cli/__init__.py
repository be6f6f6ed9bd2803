"""The command `diffabs`: one module for each command, tables, and how a command talks to a person."""
