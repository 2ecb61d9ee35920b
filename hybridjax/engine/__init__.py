"""The engine: flow of many lanes through events, its records and its derivatives."""
