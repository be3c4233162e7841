"""Draw a contact sheet of groups of photos: a row of thumbnails for each group, with the photos' names."""

from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

from refgs.capture.images import read_image
from refgs.spread import spread

SIDE = 144  # pixels of a thumbnail's longer side
GAP, TEXT = 8, 12  # pixels between thumbnails; height of a line of text
ROW = 24  # thumbnails of a group, evenly spread; larger groups show no more


def write_contact_sheet(groups: list[list[Path]], file: Path) -> None:
    """Write a PNG with a row of thumbnails for each group of photos, under a line with the group's size.

    Raises InputError if a photo cannot be read.
    """
    shown = [spread(group, ROW) for group in groups]
    across, down = SIDE + GAP, TEXT + GAP + SIDE + TEXT + 2 * GAP
    sheet = Image.new("RGB", (GAP + across * max(map(len, shown)), GAP + down * len(groups)), (32, 32, 32))
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(TEXT)
    for row, (group, photos) in enumerate(zip(groups, shown, strict=True)):
        top = GAP + row * down
        draw.text((GAP, top), f"{len(group)} photos" if len(group) > 1 else "1 photo", "white", font)
        for column, photo in enumerate(photos):
            left = GAP + column * across
            thumbnail = Image.fromarray(read_image(photo, shrink=8)[0])
            thumbnail.thumbnail((SIDE, SIDE))
            sheet.paste(thumbnail, (left, top + TEXT + GAP))
            name = photo.name
            while draw.textlength(name, font) > SIDE:
                name = f"…{name.lstrip('…')[1:]}"
            draw.text((left, top + TEXT + GAP + SIDE + 2), name, "white", font)
    sheet.save(file)
