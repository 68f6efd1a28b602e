"""Live touch: cameras, streams, their health, and the page of `anytouch view`."""
