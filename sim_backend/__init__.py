"""The arm and its controller in software, behind the same UDP protocol as the real ones."""
