"""Functions that let models of other packages in; each module imports its package only when it is called."""
