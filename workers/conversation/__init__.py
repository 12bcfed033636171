"""The worker's side of the conversation: what it answers, what it holds, and when it leaves. Imports no environment code."""
