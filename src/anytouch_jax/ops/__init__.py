"""The paper's equations as pure functions over arrays.

Nothing here knows a config, a module or a batch type.
"""
