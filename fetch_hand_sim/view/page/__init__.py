"""The page that MuJoCo's viewer draws: scene, panels, curves and mouse actions."""
