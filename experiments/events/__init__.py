"""Events and impacts inside a step."""
