"""Tests of the clients in other languages: each is built from `clients/`, and works for a learner that is a real process."""
