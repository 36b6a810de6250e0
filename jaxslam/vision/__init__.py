"""From images and odometry to a log of bearings and points (paper, section III-B).

Read `extract` first: it drives everything below.

- `camera`, `camera_files`, `foreign_camera_formats`: the calibrated camera.
- `images`, `image_times`, `extraction_journal`: input, and resuming.
- `panorama`, `edges`, `edge_localisation`, `line_merging`, `lines`: an image to its `Lines`.
- `matching`, `triangulation`, `log_triangulation`: lines of several frames to points.
- `overlay`: drawings.
"""
