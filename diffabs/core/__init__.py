"""What a part is, what a loop is, and the contracts between them. Knows no particular part."""
