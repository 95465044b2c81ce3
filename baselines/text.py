"""Instructions -> token vectors of a frozen text encoder."""

from dataclasses import dataclass


@dataclass(frozen=True)
class TextSpec:
    """Which encoder made a text embedding; stored in every cache and checkpoint."""

    name: str
    """For example `minilm` or `clip:openai/clip-vit-base-patch32`."""

    dim: int
    """Width of one token vector."""

    max_tokens: int
    """Longest instruction the encoder takes, in tokens."""

    fingerprint: str
    """SHA-256 of weights, tokenizer and pre-processing version."""
