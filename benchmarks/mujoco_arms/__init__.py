"""Sessions of arms in MuJoCo with a known fault, for a diagnosis that never met them."""
