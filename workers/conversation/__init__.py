"""The worker's side of the conversation: its answers, what it holds, and when it leaves. Imports no environment code."""
