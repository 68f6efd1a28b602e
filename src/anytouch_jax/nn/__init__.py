"""The networks.

`functional.build` is the way in; nothing outside this folder meets a Flax module.
"""
