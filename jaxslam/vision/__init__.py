"""From images to bearings and points: camera, panorama, lines, matching, triangulation."""
