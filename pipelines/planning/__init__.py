"""Formation planning after Ho et al.: forecast, distance field, costs, formation search, local planner."""
