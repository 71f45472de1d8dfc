"""What columns add to the base model: products in blocks of rows, evidence, scores, held-out errors."""
