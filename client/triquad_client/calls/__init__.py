"""What a client may ask: each call yields messages and is sent replies."""
