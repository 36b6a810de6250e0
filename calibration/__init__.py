"""Calibrations: what is fitted once, offline, and handed to extraction and filter.

- Camera, from images of a chessboard: `camera` (read first), then `corners`, `initial`, `bundle`,
  `coverage`, `camera_report`.
- Mount, from the vertical lines of rooms: `tilt`.
- Errors, from a drive whose truth is known: `sensor` (bearings), `odometry` and `points`
  (triangulated ones), with `likelihood` and `sensor_report`.
"""
