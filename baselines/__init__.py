"""Re-implemented baselines and the kit they share: views, heatmaps, samples, trainer."""
