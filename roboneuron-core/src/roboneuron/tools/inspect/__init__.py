"""Tools for inspection: installed plugins, and images of the cameras."""
