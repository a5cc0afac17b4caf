"""Garments and outfits as plain configuration: what is worn, how it is cut, what cloth it is made of."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from avatar.checks import AvatarError, unknown_name


@dataclass
class FabricConfig:
    """Cloth as the solver sees it."""

    density: float = 0.2  # kg/m^2
    stretch: float = 60.0  # N/m along the threads
    shear: float = 20.0  # N/m
    bend: float = 1.5e-5  # N m; small values wrinkle finely
    thickness: float = 0.005  # m kept between cloth vertices and what lies under them
    friction: float = 0.1  # Coulomb coefficient against skin and inner layers

    def __post_init__(self):
        for name, value in vars(self).items():
            if not value >= 0:
                raise AvatarError(f"{name}: expected a number of at least 0, got {value}.")


@dataclass
class GarmentConfig:
    """One garment, cut on the body in its bind pose.

    Heights are levels on the body, so that one cut fits every shape: 0 ankle, 1 knee, 2 hip, 3 waist, 4 chest,
    5 neck, with fractions between. A sleeve's length counts 1 to the elbow and 2 to the wrist.
    """

    name: str
    bottom: float  # level of the hem
    top: float | None = None  # level of the upper edge; None ends at a round neckline
    sleeve: float | None = None  # arm length covered; None where the garment ends below the arms
    ease: float = 0.012  # m between body and cloth at rest
    sleeve_ease: float = 0.012  # m, the same along the arms
    drop: float | None = None  # level from which the cloth hangs as one tube; None follows the body
    flare: float = 0.0  # m of half width gained per metre below the drop; without a drop, by each leg below the hip
    hood: bool = False  # covers the head but for the face; without a top
    opening: float = 0.0  # m, width of the open front; 0 is closed
    neck: float = 0.0  # m by which the neckline is lowered
    edge: float = 0.018  # m, target edge length
    waistband: float = 0.0  # m of elastic band under the upper edge
    bulk: float = 0.012  # m that it and its small folds add to the body under the next garment
    cling: float = 0.02  # N/m a vertex: elastic pull to its place on the skin where the cloth is tight
    fabric: FabricConfig = field(default_factory=FabricConfig)

    def __post_init__(self):
        if not 0.006 <= self.edge <= 0.05:
            raise AvatarError(f"edge: expected 0.006 to 0.05 m, got {self.edge}.")
        if self.top is None and self.sleeve is None:
            raise AvatarError(f"garment {self.name!r}: a garment with a neckline needs a sleeve length.")
        if not 0 <= self.bottom < (self.top or 5):
            raise AvatarError(f"garment {self.name!r}: expected bottom below top, got {self.bottom} and {self.top}.")


@dataclass
class OutfitConfig:
    """Garments worn together, the innermost first."""

    name: str
    shape: str = "female"  # of the open body, or a body file
    garments: list[GarmentConfig] = field(default_factory=list)


# The cut of each garment, as `GarmentConfig` names it
COLUMNS = ("bottom", "top", "sleeve", "ease", "sleeve_ease", "drop", "flare", "edge")
CUTS = {
    "trousers": (0.1, 2.75, None, 0.011, 0.012, None, 0.0, 0.0225),
    "slacks": (0.1, 2.75, None, 0.011, 0.012, None, 0.1, 0.02),
    "tee": (2.1, None, 0.6, 0.014, 0.016, None, 0.0, 0.016),
    "shirt": (1.6, None, 1.85, 0.022, 0.022, 3.6, 0.06, 0.0205),
    "skirt": (0.85, 2.8, None, 0.01, 0.012, 2.6, 0.22, 0.02),
    "dress": (0.35, None, 0.55, 0.012, 0.015, 2.7, 0.2, 0.0225),
    "jacket": (2.0, None, 1.85, 0.03, 0.026, 3.8, 0.03, 0.02),
    "coat": (0.75, None, 1.9, 0.025, 0.024, 3.6, 0.09, 0.023),
    "hoodie": (1.95, None, 1.9, 0.026, 0.026, None, 0.0, 0.02),
}


def garment(name: str, **changes) -> GarmentConfig:
    """A garment of `CUTS`, with settings of `GarmentConfig` beside or instead of its columns."""
    return GarmentConfig(name, **dict(zip(COLUMNS, CUTS[name])) | changes)


def trousers(**changes) -> GarmentConfig:
    """Tight ankle-length trousers held by an elastic waistband."""
    denim = FabricConfig(density=0.25, stretch=100.0, shear=40.0, bend=5e-5, thickness=0.006)
    return garment("trousers", waistband=0.03, fabric=denim, **changes)


def undershirt(edge: float) -> GarmentConfig:
    """A tight tee to wear under an open front."""
    return garment("tee", bottom=2.4, sleeve=0.4, ease=0.01, sleeve_ease=0.01, edge=edge, bulk=0.022)


GARMENTS = {
    "tee": lambda: [trousers(), garment("tee")],
    "shirt": lambda: [trousers(), garment("shirt")],
    "skirt": lambda: [garment("skirt", waistband=0.03), garment("tee", bottom=2.4)],
    "dress": lambda: [garment("dress")],
    "jacket": lambda: [
        trousers(edge=0.024),
        undershirt(0.022),
        garment("jacket", opening=0.07, neck=0.01, cling=0.01, fabric=FabricConfig(density=0.3, bend=4e-5)),
    ],
    "coat": lambda: [
        trousers(edge=0.024),
        undershirt(0.024),
        garment("coat", opening=0.05, cling=0.04, fabric=FabricConfig(density=0.3, bend=6e-5, friction=0.3)),
    ],
    "slacks": lambda: [
        garment("slacks", waistband=0.03, fabric=FabricConfig(density=0.2, bend=2e-5)),
        garment("tee", bottom=2.4, edge=0.018),
    ],
    "hoodie": lambda: [
        trousers(edge=0.024),
        garment("hoodie", hood=True, fabric=FabricConfig(density=0.3, bend=4e-5)),
    ],
}
OUTFIT_NAMES = tuple(GARMENTS)
DEFAULT_SHAPES = {name: "male" if name in ("tee", "shirt", "coat") else "female" for name in GARMENTS}


def outfit(name: str, shape: str | None = None, edge: float | None = None) -> OutfitConfig:
    """A named outfit on a body shape, its usual one if None; ``edge`` the target edge length of all garments, metres.

    Cling is a force a vertex: with more vertices to an area each of them is pulled less. Raises `AvatarError` for an
    unknown name, listing those there are.
    """
    if name not in GARMENTS:
        raise unknown_name("outfit", name, GARMENTS)
    garments = GARMENTS[name]()
    if edge is not None:
        garments = [replace(g, edge=edge, cling=g.cling * min(1, edge / g.edge) ** 2) for g in garments]
    return OutfitConfig(name, shape or DEFAULT_SHAPES[name], garments)
