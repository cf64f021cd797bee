"""Extensions of examples/extension, added from outside the package."""
