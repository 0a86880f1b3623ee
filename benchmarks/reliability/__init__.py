"""Reliability of commands and files: kills, fuzzed input, hostile rewards, full disks, two writers."""
