"""The web page of `anytouch view`: recordings, features, runs and live touch."""
