from .mechanism import Constrained as Constrained, Impact as Impact, Mechanism as Mechanism
