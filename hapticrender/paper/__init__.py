"""The paper's own tables and figures, computed again, each with its numbers and a verdict."""
