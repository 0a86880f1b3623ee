"""An algorithm, a reward, a network, a mask and a planner of somebody else's package."""
