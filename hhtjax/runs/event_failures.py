"""What may go wrong at an event, as data and in words."""

from hhtjax.systems.constraints import SWITCHED_OFF

FINE, MANY, STAYS, ALONG, CORNER, DIFFER, NO_NUMBER, NEGATIVE, THROWN, SINGULAR = range(10)
EVENTS = {  # what it is, before the number of the event, and what to do about it
    MANY: (
        "more than max_events in a step, the first of them event",
        "A motion that comes to rest on a guard gives infinitely many: let it rest by a stiff force, or a constraint "
        "that the event switches on. Else take a smaller dt, or a larger max_events",
    ),
    STAYS: (
        "the motion stays beyond the guard of event",
        "A body that rests there needs a stiff force, or a constraint that the event switches on. An event that turns "
        "nothing back needs a guard that depends on the mode its switch changes. A force that jumps there needs a "
        "mode, too",
    ),
    ALONG: (
        "no velocity changes the guard of event",
        "An impact needs a guard that depends on q, and a motion that may follow it",
    ),
    CORNER: (
        "another event happens at the same time as event",
        "Impacts one after the other are not the same as at once: say what happens by one event with its own reset",
    ),
    DIFFER: (
        "the runs that extrapolate joins do not meet the same events, the first of them event",
        "Take a smaller dt, or leave extrapolate out",
    ),
    NO_NUMBER: (
        "q and v are numbers, but not the guard of event",
        "A guard must be a number beyond its zero, too: q, not sqrt(q)",
    ),
    NEGATIVE: (
        "behind an event, with the params of its switch and the v of its reset, negative is the guard of event",
        "Guards are positive where the motion goes on: behind its event one may need the other sign, by the mode that "
        "the switch changes, or another level",
    ),
    THROWN: (
        "what another event changes takes the motion at once beyond the guard of event",
        "A guard of the velocity jumps with that, and one of params with a switch: say what happens by one event with "
        "a reset and a switch of its own, or let the guard depend on a mode",
    ),
    SINGULAR: (
        "the constraint determines no acceleration behind event",
        f"What its reset and its switch make of v and the params must be numbers, and rows independent. {SWITCHED_OFF}",
    ),
}
