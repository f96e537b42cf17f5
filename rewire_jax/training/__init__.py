"""The device's side: SAC, replay, rollouts, the compiled loop of a population."""
