"""Extensions of docs/extending.md, added from outside the package."""
