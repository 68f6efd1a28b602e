"""Fields: the head that measures depth, shear, contact and force."""
