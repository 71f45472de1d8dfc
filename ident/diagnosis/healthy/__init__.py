"""The healthy arm: its baseline, the bench of sessions beside it, its commissioning."""
