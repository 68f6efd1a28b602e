"""Touch scenes: surfaces, contact, optics and recordings of several sensors, from one seed."""
