"""SACIL: Size-Aware Contrastive Imitation Learning."""
