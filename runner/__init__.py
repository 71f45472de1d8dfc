"""What a person drives: `lwr-run` and the experiment sequence."""
