"""Plain data: what a scene, its robot and its sensors are."""
