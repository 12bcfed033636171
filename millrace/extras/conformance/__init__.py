"""The conformance test of a client, a worker in any language: `millrace conform`."""
