"""Reading of values that a person wrote: numbers, texts and tables, each refused in one line."""
