"""The interface to the agent: features, observation, reward and infos."""
