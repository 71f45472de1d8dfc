"""The choice of causes: candidates, what a healthy arm shows of them, selection, parameters."""
