"""An arm from any URDF, driven by joint torques, and controllers that use its model."""
