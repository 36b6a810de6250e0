"""The reference: FastSLAM 1.0 in plain NumPy, to test the JAX filter against.

Read `fastslam` (the particles), then `ekf` (a landmark): both are written from the paper and import
nothing of the filter. `compare` runs both filters on the same draws (`jaxslam compare`).
"""
