"""The former place of a module, see `anytouch_jax.renamed`."""

from anytouch_jax.renamed import moved

__getattr__ = moved(__name__)
