"""Which provider is run: the one that was asked for by name, or for `auto` the best that can be used."""

import inspect
import logging
from collections.abc import Callable

from lerobot_msdyn.core.config import PriorsConfig
from lerobot_msdyn.core.errors import ConfigError, PriorError
from lerobot_msdyn.core.fields import AUTO, FILE, PARAMETER
from lerobot_msdyn.core.observations import Origin
from lerobot_msdyn.priors.registry import Estimate, Provider, Unusable
from lerobot_msdyn.priors.request import Request

logger = logging.getLogger(__name__)


def provide[P: Provider, T](
    kind: type[P], wanted: str, request: Request, run: Callable[[P], Estimate[T]], *, file: Callable[[str], P]
) -> tuple[T, Origin]:
    """A prior, and where it comes from.

    Args:
        kind: which prior: the base class of its providers.
        wanted: `auto`, the name of a provider (NAME or NAME:PARAMETER), or an exchange file.
        request: what the provider is given.
        run: calls the provider's `estimate`.
        file: makes the provider that reads an exchange file.

    Raises:
        ConfigError: there is no such provider.
        PriorError: it was asked for by name and cannot be had, or none can be used.
    """
    if wanted == AUTO:
        return best(kind, request, run)
    is_file = wanted.endswith(FILE)
    provider = file(wanted) if is_file else _made(kind, wanted)
    name, why = ("file", f"read from {wanted}") if is_file else (wanted.partition(PARAMETER)[0], "asked for")
    try:
        provider.usable(request)
        return _run(kind, name, provider, request, run, why)
    except Unusable as error:
        raise _cannot(kind, wanted, error) from error


def check_named(kind: type[Provider], wanted: str, config: PriorsConfig, device: str) -> None:
    """Whether a provider that is asked for by name has what it needs, as far as that is known without a video.

    Raises:
        ConfigError: there is no such provider.
        PriorError: it has not.
    """
    if wanted == AUTO or wanted.endswith(FILE):
        return
    try:
        _made(kind, wanted).check(config, device)
    except Unusable as error:
        raise _cannot(kind, wanted, error) from error


def best[P: Provider, T](
    kind: type[P],
    request: Request,
    run: Callable[[P], Estimate[T]],
    *,
    among: Callable[[type[P]], bool] = lambda provider: True,
) -> tuple[T, Origin]:
    """The result of the highest-ranked provider that can be used; one that fails is named in a warning.

    Args:
        kind: which prior: the base class of its providers.
        request: what the provider is given.
        run: calls the provider's `estimate`.
        among: which of the providers that have a rank may be taken.

    Raises:
        PriorError: none can be used.
    """
    against: list[str] = []  # why the better ones were not taken
    for name, provider_class in _ranked(kind):
        if not among(provider_class):
            continue
        provider = provider_class()
        try:
            why = provider.usable(request)
        except Unusable as error:
            against.append(error.why)
            continue
        reasons = ", ".join(dict.fromkeys(against))
        try:
            return _run(kind, name, provider, request, run, reasons, why)
        except PriorError as error:
            logger.warning("%s: %s cannot be used: %s", kind.prior, name, error)
            against.append(f"{name} cannot be used ({error})")
    raise PriorError(f"{kind.setting}: no provider can be used: {', '.join(against) or 'there is none'}")


def _cannot(kind: type[Provider], wanted: str, error: Unusable) -> PriorError:
    return PriorError(f"{kind.setting} is {wanted!r}, but {error}")


def _run[P: Provider, T](
    kind: type[P], name: str, provider: P, request: Request, run: Callable[[P], Estimate[T]], *reasons: str
) -> tuple[T, Origin]:
    estimate = run(provider)
    problem = kind.problem(estimate.value, request.view)
    if problem:
        raise PriorError(f"the {kind.registry.kind} {name!r} returned {problem}")
    why = "; ".join(reason for reason in (*reasons, estimate.how) if reason)
    return estimate.value, Origin(estimate.provider or name, why, estimate.model)


def _ranked[P: Provider](kind: type[P]) -> list[tuple[str, type[P]]]:
    """The providers that `auto` may take, the best first."""
    ranked = []
    for name in kind.registry.names():
        try:
            provider = _named(kind, name)
        except ConfigError as error:  # another package's: nobody has asked for it
            logger.warning("%s is left out: %s", name, error)
            continue
        if provider.rank is not None and not provider.needs_whole_videos and not provider.parameter:
            ranked.append((name, provider))
    return sorted(ranked, key=lambda item: (-(item[1].rank or 0), item[0]))


def _made[P: Provider](kind: type[P], wanted: str) -> P:
    """The provider of NAME or NAME:PARAMETER.

    Raises:
        ConfigError: there is none, or it takes a parameter and has none, or the other way round.
    """
    name, colon, parameter = wanted.partition(PARAMETER)
    provider = _named(kind, name)
    if bool(provider.parameter) != bool(parameter):
        expected = f"{name}:{provider.parameter}" if provider.parameter else f"{name} alone"
        raise ConfigError(f"{kind.setting} is {wanted!r}; expected {expected}")
    make: Callable[..., P] = provider
    return make(parameter) if colon else make()


def _named[P: Provider](kind: type[P], name: str) -> type[P]:
    """The provider of a name, which is checked to be one of this kind.

    Raises:
        ConfigError: there is none, or it is something else.
    """
    provider: object = kind.registry.get(name)
    if not (isinstance(provider, type) and issubclass(provider, kind)) or inspect.isabstract(provider):
        raise ConfigError(
            f"{kind.registry.kind} {name!r} is {provider!r}; expected a class derived from {kind.__name__} with a "
            "method `estimate`"
        )
    return provider
