"""Does it make policies better? A study of closed-loop success from moved cameras (`python -m benchmarks.policy`)."""
