"""Formulas as docstrings write them, in plain letters, for Sphinx: as LaTeX, which `mathml` draws.

M(q) w = Q(q, v, t) + B^T L,    |q|^2 <= omega^-1    ->    M(q)\\,w=Q(q,v,t)+B^T L,\\quad |q|^2\\le\\omega^{-1}
"""

import re

GREEK = (
    "alpha beta gamma delta epsilon zeta eta theta kappa lambda mu nu xi pi rho sigma tau phi chi psi omega "
    "Gamma Delta Theta Lambda Sigma Phi Psi Omega"
)
SHORT = {"eps": "\\epsilon", "Om": "\\Omega", "inf": "\\infty", "int": "\\int"}
LETTERS = {name[0]: f"\\{name[0]}" for name in re.finditer(r"\w+", GREEK)} | SHORT
FUNCTIONS = "sin|cos|tan|cot|exp|log|max|min"
UPRIGHT = "sinc|diag|tr|sign|cond|rms|mean|median|Re"  # functions that LaTeX has no name for
WORDS = (
    "with|where|and|at|on|for|of|by|over|the|each|both|same|its|alone|side|twice|once|neighbours|samples|entries|sweep"
    "|step|start|run|constraints|reference|explicit|made|method|rest|principal|eigenvalues?|late|besides|order|stable|all"
)
DOTTED = r"(psi|[A-Za-z])(dot)"
TOKEN = re.compile(
    r"(?P<cross>(?<=[\w'|)]) x (?=[\w(|]))|(?P<word>[A-Za-z]+)(?P<number>\d*)(?P<tilde>~?)|(?P<below>_-?\w+)"
    r"|(?P<above>\^(?:-?\w+|\([^)]*\)))|(?P<sign><=|>=|!=|\.\.|~|\||'|\{|\}|&|%|#)|(?P<space> +)|(?P<other>.)"
)
GAP = re.compile(r"(?<=[,.;:]) {2,}| {3,}")  # between two formulas on a line
OPERATOR = r"[-+=/,;:()\[\]|<>]|\\(?:le|ge|ne|sim|times|text)\b"
SIGNS = {"<=": "\\le ", ">=": "\\ge ", "!=": "\\ne ", "..": "\\ldots ", "'": "'", "{": "\\{", "}": "\\}", "|": "|"}


def is_formula(lines):
    """Whether all words of an indented block are symbols, and it says that something is equal or less."""
    text = "\n".join(lines)
    if not re.search(r"[=~]|->", text) or re.search(r'["`#]|;\s*$|>>>|\w\.\w|//|\w=\w|::|d2', text, flags=re.MULTILINE):
        return False  # code, a table, or a second derivative
    return all(is_symbol(word) for word in re.findall(r"(?<![A-Za-z])[A-Za-z]+", text))


def is_symbol(word):
    """A letter, or letters that stand for one; or one of the few words that stand between formulas."""
    if word in LETTERS or len(word) <= 2 or len(letters(word)) > 1:
        return True
    return bool(re.fullmatch(f"{FUNCTIONS}|{UPRIGHT}|{WORDS}|{DOTTED}|sqrt|sum", word))


def letters(word):
    """The letters that a word is written with: rhoA is rho A, dPhi is d Phi, EIy is E I y. [word] if it is a word."""
    pieces = re.findall("|".join([*sorted(LETTERS, key=len, reverse=True), FUNCTIONS, "[A-Za-z]"]), word)
    is_compound = any(x in LETTERS for x in pieces) or word[:-1].isupper()
    return pieces if is_compound and len(pieces) <= 3 else [word]


def latex(lines):
    """Lines of plain formulas as LaTeX; what stands in columns stays in columns."""
    rows = [[cell(x) for x in GAP.split(line.strip())] for line in lines]
    if len(rows) == 1:
        return "\\quad ".join(rows[0])
    if len({len(row) for row in rows}) > 1:
        rows = [["\\quad ".join(row)] for row in rows]
    body = " \\\\ ".join(" & ".join(row) for row in rows)
    return f"\\begin{{array}}{{{'l' * len(rows[0])}}}{body}\\end{{array}}"


def cell(formula):
    """One formula as LaTeX: spaces only where two factors meet."""
    text = "".join(piece(found) for found in TOKEN.finditer(roots(formula)))
    text = re.sub(rf"\s*\\,\s*(?={OPERATOR})", " ", text)
    return re.sub(rf"((?:{OPERATOR})|\}}(?<=\s\}}))\s*\\,\s*", r"\1 ", text)


def roots(line):
    """sqrt(x), with its matching bracket, as a root."""
    while (start := line.find("sqrt(")) >= 0:
        depth, end = 1, start + 5
        while depth and end < len(line):
            depth += {"(": 1, ")": -1}.get(line[end], 0)
            end += 1
        line = f"{line[:start]}\x01{line[start + 5 : end - 1]}\x02{line[end:]}"
    return line


def piece(found):
    """A token of a formula as LaTeX."""
    text = found[0]
    match found.lastgroup:
        case "cross":
            return "\\times "
        case "below" | "above":
            index = text[1:].strip("()") if text[1] == "(" and text.count("(") == 1 else text[1:]
            return f"{text[0]}{{{''.join(piece(x) for x in TOKEN.finditer(index))}}}"
        case "sign":
            return SIGNS.get(text, f"\\{text}") if text != "~" else "\\sim "
        case "space":
            return "\\, "
        case "other":
            return {"\x01": "\\sqrt{", "\x02": "}"}.get(text, text)
    letter = f"\\tilde{{{symbol(found['word'])}}}" if found["tilde"] else symbol(found["word"])
    return letter + (f"_{{{found['number']}}}" if found["number"] else "")


def symbol(word):
    """A word of a formula as LaTeX."""
    if dotted := re.fullmatch(DOTTED, word):
        return f"\\dot{{{symbol(dotted[1])}}}"
    if re.fullmatch(FUNCTIONS, word):
        return f"\\{word} "
    if word == "sum":
        return "\\sum "
    if re.fullmatch(UPRIGHT, word) or (len(word) > 2 and word.isupper()):
        return f"\\mathrm{{{word}}}"
    if re.fullmatch(WORDS, word):
        return f"\\text{{ {word} }}"
    if word in LETTERS:
        return f"{LETTERS[word]} "
    return " ".join(LETTERS.get(x, x) for x in letters(word)) + " "
