"""Labels of pieces of furniture, derived from English ids and names, or from names in any language."""

import re
from collections.abc import Iterable, Mapping, Sequence

Size = tuple[float, float, float]
"""Width, depth and height, metres."""

RULES: tuple[tuple[str, str], ...] = (
    ("", r"(lamps?|lights?)( \d+)?$|^lamp|\bfan\b|tennis|football|billiard|\bpool (?!lounge)|\bbat$|horse|\bcars?\b|"
         r"window|\bdoor|wheel ?chair|hammock|sleeping|changing|electric chair|mattress$|container|workbench|"
         r"abdominal|piano|swimming|\bchairman|bed ?spread|table ?ware|table ?fan|chair ?lift|bedding|flower ?bed"),
    ("lounger", r"lounger|pool ?lounge|(deck|beach|relax) ?chair|chair deck|chaise ?longue|sun ?bed"),
    ("cot", r"baby ?(rocking )?bed|\bcrib|cradle|\bcot\b"),
    ("high_chair", r"high ?chair"),
    ("nightstand", r"bed ?side|night ?(stand|table)"),
    ("stool", r"stool|bar ?chair|puff?\b|pouf|(?<!chair )ottoman$"),
    ("sofa", r"sofa|couch|divan|settee|canape"),
    ("bench", r"bench"),
    ("armchair", r"arm ?chair|easy ?chair|fauteuil|fotel|rocking chair|club ?chair"),
    ("chair", r"chair|\bclass ?seat|silla|\bstuhl"),
    ("bed", r"\bbeds?\b|bunk|mezzanine|futon|cama\b"),
    ("desk", r"desk|biurko|bureau\b|secretary|(dressing|vanity) ?table"),
    ("table", r"\b(coffee|tea|dining|side|end|work|kitchen|office|cafe|bar|picnic)?tables?\b"),
    ("wardrobe", r"wardrobe|closet|armoire"),
    ("dresser", r"dresser|chest of drawers|commode|drawers"),
    ("shelf", r"book ?(case|shel)|shel(f|ves|ving)\b"),
    ("sideboard", r"sideboard|buffet|cupboard"),
    ("tv_stand", r"tv (unit|stand|furniture)|television (unit|stand)"),
    ("fridge", r"fridge|refrigerator"),
    ("toilet", r"\btoilet( unit)?$|\bwc\b"),
    ("basin", r"wash ?basin"),
    ("bath", r"\bbath( ?tub)?$"),
    ("floor_lamp", r"floor (up)?lamp"),
    ("plant", r"\bplant|ficus|bamboo|bonsai|yucca"),
)  # fmt: skip
"""Kinds and patterns of English words in order of precedence; "" marks objects only named like furniture."""

EXCEPTIONS = {"floor_lamp": r"floor (up)?(lamp|light)"}
"""Kinds to which the first rule does not apply."""

WORDS: Mapping[str, Sequence[str]] = {
    "": (
        "*rollstuhl", "rolstoel", "rullstol", "pyörätuoli", "fauteuil roulant", "silla de ruedas", "sedia a rotelle",
        "轮椅", "車椅子", "*wickeltisch", "table à langer", "*billardtisch", "*tischtennis",
    ),
    "lounger": (
        "chaise longue", "transat", "*liegestuhl", "*sonnenliege", "*ligstoel", "*ligbed", "sdraio", "tumbona",
        "aurinkotuoli", "*solsäng", "*solseng", "шезлонг", "躺椅",
    ),
    "high_chair": ("chaise haute", "*hochstuhl", "seggiolone", "trona", "syöttötuoli"),
    "nightstand": (
        "chevet", "table de nuit", "*nachttisch", "*nachtkästchen", "*nachtschrank", "*nachtkastje", "*nachttafel",
        "comodino", "mesita de noche", "mesilla", "mesa de noche", "mesa de cabeceira", "criado-mudo", "*sängbord",
        "*nattduksbord", "*natbord", "*nattbord", "stolik nocny", "szafka nocna", "noční stolek", "*yöpöytä",
        "прикроватный столик", "прикроватная тумбочка", "éjjeliszekrény", "床头柜", "床頭櫃", "ナイトテーブル",
        "협탁", "κομοδίνο", "нощно шкафче", "komodin", "tủ đầu giường",
    ),
    "armchair": (
        "fauteuil", "*sessel", "poltrona", "sillon", "sillón", "*fåtölj", "fauteuille", "fotel", "*nojatuoli", "кресло",
        "*lænestol", "扶手椅", "肘掛け椅子", "안락의자", "πολυθρόνα", "křeslo", "*fotelj", "фотьойл", "ghế bành",
    ),
    "chair": (
        "chaise", "*stuhl", "sedia", "silla", "cadeira", "*stol", "*stoel", "krzesło", "židle", "*tuoli", "стул",
        "стол за", "*szék", "椅子", "いす", "イス", "의자", "καρέκλα", "стілець", "sandalye", "ghế", "כיסא", "كرسي",
    ),
    "bed": (
        "lit", "*bett", "*bed", "letto", "cama", "*säng", "*seng", "łóżko", "postel", "*sänky", "кровать", "*ágy", "床",
        "ベッド", "침대", "κρεβάτι", "легло", "ліжко", "yatak", "giường", "מיטה", "سرير",
    ),
    "desk": (
        "*schreibtisch", "*bureautafel", "*työpöytä", "scrivania", "escritorio", "escrivaninha", "secretária",
        "*skrivbord", "bureau", "biurko", "*kirjoituspöytä", "письменный стол", "*íróasztal",
        "书桌", "デスク", "책상", "γραφείο", "бюро",
    ),
    "table": (
        "*tisch", "tavolo", "mesa", "*bord", "*tafel", "stół", "stůl", "*pöytä", "стол", "*asztal", "桌", "テーブル",
        "테이블", "τραπέζι", "маса", "стіл", "masa", "bàn", "שולחן", "طاولة",
    ),
    "sofa": ("canapé", "divano", "sofá", "soffa", "диван", "kanapa", "pohovka", "kanapé", "沙发", "ソファ", "소파"),
    "stool": ("tabouret", "*hocker", "sgabello", "taburete", "pall", "*kruk", "*barkruk", "taboret", "табурет"),
}  # fmt: skip
"""Names in other languages for furniture without a known id or model; a leading star allows any prefix."""

BEFORE_ENGLISH = ("", "lounger", "high_chair", "nightstand")
"""Kinds whose names contain the word for another kind, which may be English ("table de chevet")."""

OFFICE = re.compile(r"office|desk|swivel|task|büro|bureau|kantoor|kontor|toimisto", re.IGNORECASE)


def label_of(texts: Sequence[str], size: Size) -> str | None:
    """Return the label of furniture with these English texts, in order of precedence, or None if unknown."""
    for text in texts:
        spaced = words_of(text)
        for kind, pattern in RULES:
            exempt = kind == "" and any(re.search(exception, spaced) for exception in EXCEPTIONS.values())
            if not exempt and re.search(pattern, spaced):
                return by_size(kind, size, bool(OFFICE.search(" ".join(texts)))) if kind else None
    return None


def label_of_name(name: str, known: Mapping[str, str], size: Size) -> str | None:
    """Return the label of a name in any language: by a catalogue, else by single words.

    Args:
        name: name of the piece.
        known: labels by lower-case names of catalogues.
        size: size of the piece, metres.
    """
    folded = name.casefold().strip()
    if folded in known:
        return known[folded]
    kind = _kind_by_words(folded, BEFORE_ENGLISH)
    if kind is None:
        if (label := label_of([folded], size)) is not None:
            return label
        kind = _kind_by_words(folded, WORDS)
    return by_size(kind, size, bool(OFFICE.search(folded))) if kind else None


def only_named_like_furniture(texts: Sequence[str]) -> bool:
    """Check whether an English text has a word for furniture and another that excludes furniture."""
    exclusion, *others = (pattern for _, pattern in RULES)
    return any(
        re.search(exclusion, spaced) and any(re.search(pattern, spaced) for pattern in others)
        for spaced in map(words_of, texts)
    )


def _kind_by_words(folded: str, kinds: Iterable[str]) -> str | None:
    for kind in kinds:
        for word in WORDS[kind]:
            plain = word.removeprefix("*")
            spaced = plain[0] < "\u0590"  # scripts with spaces between words
            start = r"\b" if spaced and plain == word else ""
            if re.search(f"{start}{plain}" + (r"\b" if spaced else ""), folded):
                return kind
    return None


def by_size(kind: str, size: Size, office: bool) -> str:
    """Return the label of a kind, which may depend on the size or on the use in an office."""
    width, depth, height = size
    match kind:
        case "chair":
            return "office_chair" if office else "chair"
        case "bed":
            return "bunk_bed" if height > 1.4 else "double_bed" if min(width, depth) > 1.25 else "single_bed"
        case "table" if max(width, depth) < 0.64 and height < 0.72:
            return "side_table"
        case "table":
            return "coffee_table" if height < 0.6 else "dining_table"
        case _:
            return kind


def words_of(text: str) -> str:
    """Return an id or file name as words: "eTeks#squareTable" becomes "square table"."""
    tail = re.split(r"[#/]", text)[-1].removesuffix(".obj")
    spaced = re.sub(r"(?<=[a-z])(?=[A-Z])|[_\-.]|(?<=\D)(?=\d)", " ", tail)
    return " ".join(spaced.casefold().split())
