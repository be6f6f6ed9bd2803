"""Functions of one lane as native code for many."""
