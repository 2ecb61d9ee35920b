from .balls import (
    BouncingBall as BouncingBall,
    BouncingChain as BouncingChain,
    PaddleJuggler as PaddleJuggler,
)
from .bipeds import FiveLinkBiped as FiveLinkBiped, TorsoWalker as TorsoWalker
from .converters import BuckConverter as BuckConverter, CukConverter as CukConverter
from .hoppers import (
    CompliantHopper as CompliantHopper,
    HopperPair as HopperPair,
    VerticalHopper as VerticalHopper,
)
from .neurons import (
    AdExNeuron as AdExNeuron,
    FitzHughNagumo as FitzHughNagumo,
    IzhikevichNeuron as IzhikevichNeuron,
)
from .oscillators import (
    BeltOscillator as BeltOscillator,
    ChuaCircuit as ChuaCircuit,
    Duffing as Duffing,
    HopfOscillator as HopfOscillator,
    Mathieu as Mathieu,
    RotorFlap as RotorFlap,
    VanDerPol as VanDerPol,
)
from .runners import (
    SLIPRunner as SLIPRunner,
    TrottingQuadruped as TrottingQuadruped,
    TwoLeggedBar as TwoLeggedBar,
)
from .walkers import (
    CompassGait as CompassGait,
    RimlessWheel as RimlessWheel,
    SimplestWalker as SimplestWalker,
)
