"""Recorded results of a run and their readers: columns, history, fields."""
