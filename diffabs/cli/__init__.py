"""The command `diffabs`: one module for each command, the tables on stdout, and the messages on stderr."""
