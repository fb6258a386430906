"""What only the notebooks need, one module each, `from lessons import n03`, and the tools that make their companions."""
