"""Functions that let models of other packages in; each imports its package only when it is called."""

from diffabs.engine.interop.diffrax import field_of as field_of
