"""The page that MuJoCo's viewer draws: panels, curves and the mouse over the scene."""
