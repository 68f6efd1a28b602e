"""The former place of `anytouch_jax.live.page`, see `anytouch_jax.renamed`."""
