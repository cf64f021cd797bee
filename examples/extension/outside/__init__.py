"""Extensions of mocap in a package of its own: `pip install examples/extension`."""
