//! The option bytes of known chips.

use device::option_bytes::{BrownOut, OptionBytes, ReadProtection};

#[test]
fn a_chip_as_it_is_delivered_has_no_brown_out_reset() {
    // The reset value in the manual, and what was read from a part.
    for word in [0x0FFF_AAED, 0x00FF_AAED] {
        let delivered = OptionBytes(word);
        assert_eq!(delivered.brown_out(), BrownOut::Off);
        assert!(!delivered.watchdog_by_hardware());
        assert_eq!(delivered.read_protection(), ReadProtection::None);
        assert_eq!(delivered.protected_sectors(), 0);
    }
}

#[test]
fn each_field_is_read_from_its_own_bits() {
    let levels = [
        (0x0FFF_AAE1, BrownOut::Level3),
        (0x0FFF_AAE5, BrownOut::Level2),
        (0x0FFF_AAE9, BrownOut::Level1),
        (0x0FFF_AAED, BrownOut::Off),
    ];
    for (word, level) in levels {
        assert_eq!(OptionBytes(word).brown_out(), level, "{word:#x}");
        // No other bit has a say.
        assert_eq!(OptionBytes(word ^ !0xC).brown_out(), level, "{word:#x}");
    }
    assert!(OptionBytes(0x0FFF_AACD).watchdog_by_hardware());
    for (word, protection) in [
        (0x0FFF_00ED, ReadProtection::Level1),
        (0x0FFF_FFED, ReadProtection::Level1),
        (0x0FFF_CCED, ReadProtection::Level2),
    ] {
        assert_eq!(OptionBytes(word).read_protection(), protection, "{word:#x}");
    }
    assert_eq!(OptionBytes(0x0FF1_AAED).protected_sectors(), 0b1110);
    assert_eq!(OptionBytes(0x8F0E_AAED).protected_sectors(), 0b1110);
}
