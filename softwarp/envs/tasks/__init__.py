"""One task per file: configuration, actions, observation, reward, ends."""
