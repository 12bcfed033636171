"""The conformance test for clients, which are workers written in any language: `millrace conform`."""
