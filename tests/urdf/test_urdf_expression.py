"""Expressions of xacro: 200 have the values of the library's own evaluation, and none can reach out."""

import pytest
import xacro

from magtwin.urdf.source.expression import GLOBALS, Budget, ExpressionError, evaluate

NAMES = {
    "width": 0.3,
    "n": 4,
    "side": "left",
    "prefix": "arm_",
    "sizes": [0.1, 0.2, 0.3],
    "pair": (1, 2),
    "wheels": {"left": 0.1, "right": -0.1, "spec": {"radius": 0.05}},
    "on": True,
    "words": "front rear mid",
}

EXPRESSIONS = """
1 + 2; 2 * width; width / 2; -width; +width; n ** 2; n // 3; n % 3; 2 ** -1; 7 - 2 * 3; (7 - 2) * 3
1e-3 * 5; 0x1f; 0b101; 1_000; .5; 1.; 3 / 4; -7 // 2; -7 % 3; 2 ** 0.5; 1e308 * 10; n & 6; n | 3; n ^ 5; ~n
1 << n; 256 >> 3; n < 5; n <= 4; n == 4; n != 4; n > 5; n >= 5; 1 < n < 5; 1 < n > 5; not on; on and n
on or n; 0 or side; '' and n; n is None; None is None; n is not None; 'a' in 'abc'; 'x' not in side
2 in pair; 'left' in wheels; 0.5 in sizes; 'yes' if on else 'no'; 1 if n > 3 else 2 if n > 2 else 3
side == 'left'; side != 'right'; prefix + side; side * 2; side[0]; side[-1]; side[1:]; side[:2]; side[::-1]
side[1:3]; sizes[0]; sizes[-1]; sizes[1:]; sizes[::2]; pair[1]; wheels['left']; wheels['spec']['radius']
wheels.get('left'); wheels.get('none', 3); sorted(wheels.keys()); list(wheels.keys()); list(wheels)
len(wheels); [k for k in wheels]; [v for v in wheels.values() if v != wheels['spec']]; {'a': 1}
{**{'a': 1}, 'b': 2}; {'a': 1} | {'b': 2}; {k: len(k) for k in wheels}; dict(a=1, b=2); dict([('a', 1)])
[1, 2] + [3]; [0] * 3; [*sizes, 1]; [*pair, *pair]; (1,) + pair; (*pair, 3); [x * 2 for x in sizes]
[x for x in range(5) if x % 2]; [x + y for x in pair for y in pair]; [a for a, b in [(1, 2), (3, 4)]]
list(range(3)); set(['a', 'b']) - set(['b']); set([1, 2]) & set([2, 3]); set([1]) | set([2])
set([1, 2]) ^ set([2, 3]); {1, 2} - {1}; len({1, 1, 2}); {1, 2} == {2, 1}; {1} <= {1, 2}; {1} < {1}
{1, 2} >= {2}; 1 in {1, 2}; sorted({3, 1, 2}); list({7}); {x % 2 for x in range(6)}; sorted(set('hello'))
set([1, 2]).union([3]); set([1, 2]).intersection([2]); {1}.issubset([1]); set([1, 2]).difference([1])
{1, 2}.symmetric_difference([2, 3]); {1, 2}.issuperset([1]); bool(set()); set() == set([]); side.upper()
side.capitalize(); 'A'.lower(); 'aB'.swapcase(); side.title(); ' a '.strip(); 'a b'.split()
'a,b'.split(','); words.split()[1]; ','.join(['a', 'b']); '_'.join(words.split()); 'abc'.replace('b', 'x')
'abc'.find('c'); 'abc'.index('b'); 'abc'.startswith('a'); 'abc'.endswith('c'); 'aba'.count('a')
'12'.isdigit(); 'ab'.isalpha(); 'a1'.isalnum(); ' '.isspace(); 'a_b'.partition('_'); 'a_b_c'.rpartition('_')
'a b c'.rsplit(' ', 1); 'x.stl'.removesuffix('.stl'); 'arm_l'.removeprefix(prefix); 'abca'.rfind('a')
'a\\nb'.splitlines(); 'AB'.isupper(); 'ab'.islower(); 'Ab'.istitle(); 'ß'.casefold(); 'x1'.isidentifier()
'%d' % n; '%.2f' % width; '%s_%s' % (prefix, n); '%05.1f' % width; '%(left)s' % wheels; f'{side}_{n}'
f'{width:.2f}'; f'{n:03d}'; f'{side!r}'; f'{1 + 1}'; str(1.5); str(n); str(sizes); int('3'); int(2.7)
float('1e3'); bool(''); min(1, 2); max(sizes); min(sizes); round(2.567, 1); round(2.5); len(side)
len(sizes); sorted([3, 1]); sorted(['b', 'a'], reverse=True); sorted(sizes, key=lambda v: -v)
list(map(lambda v: v * 2, sizes)); max(sizes, key=lambda v: -v); (lambda a: a + 1)(2)
(lambda a, b=3: a + b)(1); (lambda a, b=3: a * b)(2, b=5); (lambda: n)(); (lambda a=1: a)()
(lambda a, b: a - b)(5, 3); pi; sin(0); cos(pi); sqrt(2); atan2(1, 1); radians(180); degrees(pi)
hypot(3, 4); floor(2.7); ceil(2.1); exp(1); log(e); tau; inf; math.sin(math.pi / 6); math.factorial(5)
math.prod([1, 2, 3]); factorial(6); prod([2.5, 2]); math.comb(5, 2); math.gcd(12, 18); fabs(-2)
math.floor(-0.5); math.isclose(0.1 + 0.2, 0.3); copysign(1, -3); math.fsum([.1] * 10); math.trunc(2.9)
python.abs(-3); python.sum([1, 2]); python.any([0, 1]); python.all([1, 1])
python.list(python.enumerate('ab')); python.list(python.zip('ab', [1, 2])); python.divmod(7, 2)
python.ord('a'); python.isinstance(n, int); python.len(python.tuple([1, 2])); list(python.reversed([1, 2]))
list(python.filter(None, [0, 1]))
"""
EACH = [text.strip() for line in EXPRESSIONS.splitlines() for text in line.split(";") if text.strip()]


def plain(value):
    """A value of the library as ours are: sets as sorted lists."""
    if isinstance(value, set | frozenset) or type(value).__name__ == "_Set":
        return sorted(value)
    return dict(value) if isinstance(value, dict) else value


def test_expressions_have_the_values_of_the_library():
    assert len(EACH) >= 200
    xacro.verbosity = 0
    peer, differ = {**xacro.create_global_symbols(), "set": set, **NAMES}, {}
    for text in EACH:
        theirs = plain(xacro.safe_eval(text, dict(peer)))
        try:
            ours = plain(evaluate(text, {**GLOBALS, **NAMES}, Budget(100_000)))
        except ExpressionError as error:
            ours = str(error)
        if repr(ours) != repr(theirs):
            differ[text] = ours, theirs
    assert not differ


@pytest.mark.parametrize(
    "text",
    [
        *("().__class__", "sizes.append(1)", "''.__class__", "(lambda: 0).__globals__", "'{0.x}'.format(n)"),
        *("factorial(100000)", "prod([2**4000, 2**4000])", "1 << 10**6", "2 ** 10**6", "comb(10**6, 2)"),
        *(
            "f'{n:1000}'",
            "open('x')",
            "__import__('os')",
            "[*range(65536), *range(65536)]",
            "(lambda *a: a)(1)",
        ),
        *("'a'.encode()", "f'{sizes.__len__}'", "math.__loader__", "python.type(n)", "{1}.add(2)"),
        "(lambda *a: a)(1)",
    ],
)
def test_what_reaches_out_or_has_no_bound_is_refused(text):
    with pytest.raises(ExpressionError):
        evaluate(text, {**GLOBALS, **NAMES}, Budget(1_000_000))
