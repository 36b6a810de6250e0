"""A furnished room, rendered for a mirror camera that is driven round it, with the exact truth.

Read `geometry` (surfaces, edges, visibility), `furniture` and `textures` (draw the room),
`trajectory` (the drive), `raycast` (ideal images), then `render`, which adds a camera's flaws and
writes the folder.
"""
