"""Studies: each folder has the code, controllers, figures and page of one; `run.py` is its entry."""
