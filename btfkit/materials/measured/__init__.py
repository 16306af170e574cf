"""Materials that are the measurement itself: answers are blended from measured pairs."""
