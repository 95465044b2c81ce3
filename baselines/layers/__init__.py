"""Parts of networks: attention, image and point encoders, heads."""
