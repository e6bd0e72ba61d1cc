"""`clothgym demo`: the tour, one file a section."""
