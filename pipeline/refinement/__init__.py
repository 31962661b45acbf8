"""Poses refined on the matches: pair by pair, or the flight as a whole, with the log as prior."""
