"""An arm from any URDF, driven by joint torques, and the laws that know its model."""
