"""What a reader sees: figures (pure functions), widgets (thin shells over figures), exercises (checkers)."""
