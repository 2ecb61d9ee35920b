"""Families of Poincaré sections; subclass `AbstractSections` to add one."""
