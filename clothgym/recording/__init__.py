"""Recording: pictures and replayable episodes; reads state, never writes it."""
