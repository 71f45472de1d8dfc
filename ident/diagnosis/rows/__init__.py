"""Sessions to rows of the nominal arm, at the full bandwidth of the channels."""
