"""From camera images to what a network reads: clouds, virtual views, neighbourhoods of points."""
